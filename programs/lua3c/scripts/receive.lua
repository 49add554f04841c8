idl = 10
n3c.listen(idl) -- registra o id=10 para ser lido pelo stack de rede
while true do
    r,id,data = n3c.rx() -- lê o dado que estiver disponível (r informa se há algum)
    if r==true then
        h3c.dOut(17, data) --coloca na saída 17 o valor recebido
    end
end
